"""`python -m atlantis_exp [VERB] overrides`: no verb means train; only the verb's own module is imported."""

import importlib
import sys

VERBS = {
    "train": "one run, from a composed config; the same command again continues or reports it",
    "evaluate": "a stored run's network, played again: run=NAME epsilon=0.05",
    "baseline": "a player without a network: agent=random, agent=constant",
    "query": "what the environment is",
    "report": "the results that the outputs folder holds, as a table",
    "ui": "the MLflow UI on the local store",
}


def main() -> None:
    """Run the verb that the command line names first."""
    first = sys.argv[1] if len(sys.argv) > 1 else ""
    if first in VERBS:
        del sys.argv[1]
        verb = first
    elif first and "=" not in first and first[0] not in "-~+":
        import difflib

        close = difflib.get_close_matches(first, VERBS, n=1)
        hint = f"did you mean '{close[0]}'?" if close else "no valid choice is near"
        print(f"atlantis_exp: {first}: no such verb; {hint} (valid: {', '.join(VERBS)})", file=sys.stderr)
        sys.exit(2)
    else:
        verb = "train"
    importlib.import_module(f"atlantis_exp.commands.{verb}").main()


if __name__ == "__main__":
    main()
