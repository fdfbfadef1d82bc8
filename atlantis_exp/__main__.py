"""`python -m atlantis_exp [VERB] overrides`: no verb means train; only the verb's own module is imported."""

import importlib
import sys

from atlantis_exp.commands import VERBS


def main() -> None:
    """Run the verb that the command line names first."""
    first = sys.argv[1] if len(sys.argv) > 1 else ""
    if first in VERBS:
        del sys.argv[1]
        verb = first
    elif first and "=" not in first and first[0] not in "-~+":
        from atlantis_exp.config import nearest

        print(f"atlantis_exp: {first}: no such verb; {nearest(first, VERBS)}", file=sys.stderr)
        sys.exit(2)
    else:
        verb = "train"
    importlib.import_module(f"atlantis_exp.commands.{verb.replace('-', '_')}").main()


if __name__ == "__main__":
    main()
