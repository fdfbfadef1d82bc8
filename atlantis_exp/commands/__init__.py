"""The verbs, one module each: schema, overrides and one call into `sessions`, which does the work.

In: the words of a command line. Out: checked values. Only this package knows the command line, Hydra and OmegaConf.
"""

import importlib
import sys
from contextlib import suppress
from pathlib import Path

from atlantis_exp import interrupts
from atlantis_exp.faults import ConfigError, Fault, in_words

VERBS = {
    "train": "train a network; the same command continues it or prints its result",
    "decide": "train seeds until a question is answered: model=cnn,resnet_fast",
    "compare": "compare groups of finished runs: intervals, a verdict, a page of figures: by=model,sampler",
    "evaluate": "play a stored run's network again: run=NAME epsilon=0.05; an exported one: weights=FOLDER",
    "report": "print the results in the outputs folder as a table",
    "ui": "serve the MLflow UI on the local store",
    "search": "find the best values of any keys with Optuna: trials=20 optimizer=adam,rmsprop",
    "export": "export a stored run's network to share it: weights, card, scores: run=NAME to=pretrained/NAME",
    "baseline": "play without a network, as a tracked run: agent=random, agent=constant",
    "play": "play yourself at the keyboard, as a tracked run: player=NAME",
    "query": "describe the environment and how this config uses it",
    "check": "test a component's contracts and measure its cost: model=mynet plugins=./mynet.py",
    "new": "write a package with a component to start from: model=mynet to=FOLDER",
    "sync": "publish run folders to MLflow, to a server with to=URI, again and again with every=30s",
}
"""The verbs and their purposes, as `--help` lists them: daily ones first."""
DAILY = 6

_PACKAGE = Path(__file__).resolve().parents[1]
CHECKOUT = _PACKAGE.parent
CONF = _PACKAGE / "conf" if (_PACKAGE / "conf").is_dir() else CHECKOUT / "conf"
"""The config groups, of a checkout or of an installed package."""


def default_outputs() -> Path:
    """Return the outputs folder: in the checkout, or in the working directory for an installed package."""
    return (CHECKOUT if CONF.parent == CHECKOUT else Path.cwd()) / "outputs"


def main() -> None:
    """Run the verb that the command line names first; only its own module is imported.

    A `Fault` or an OSError ends the process with one line and its exit code, which is 2 for a user's mistake.
    """
    interrupts.listen()
    try:
        verb, arguments = _split(sys.argv[1:])
        importlib.import_module(f"atlantis_exp.commands.{verb}").VERB.run(arguments)
    except (Fault, OSError) as error:
        from atlantis_exp import terminal

        known = error if isinstance(error, Fault) else Fault(in_words(error))
        terminal.warn(str(known))
        sys.exit(known.exit_code)
    except (Exception, KeyboardInterrupt) as error:
        if isinstance(error, Exception) and not interrupts.seen():
            raise
        print("atlantis_exp: interrupted", file=sys.stderr)  # before a verb handles signals
        sys.exit(130)  # 128 + SIGINT


def _split(words: list[str]) -> tuple[str, list[str]]:
    """Return a command line's verb and its arguments; or print help, completions or the version, and exit.

    Raises: ConfigError.
    """
    from atlantis_exp import terminal

    terminal.guard()
    if words and words[0] in ("--help", "-h") and {*words[1:2]} & VERBS.keys():
        words = [words[1], words[0], *words[2:]]
    first, *rest = words or [""]
    if first in VERBS:
        verb, arguments = first, rest
    elif first and "=" not in first and first[0] not in "-~+":
        from atlantis_exp.checking import nearest

        raise ConfigError(f"{first}: no such verb; {nearest(first, VERBS)}")
    else:
        verb, arguments = "train", words
    if first in ("--complete", "--completion"):
        from atlantis_exp.commands.completing import complete

        text = complete(first, rest)
    elif {"--help", "-h"} & {*arguments}:
        from atlantis_exp.commands.helping import help_text, overview

        text = help_text(verb, arguments) if first in VERBS or len(arguments) > 1 else overview()
    elif "--version" in arguments:
        from importlib.metadata import version

        text = f"atlantis-exp {version('atlantis-exp')}"
    else:
        return verb, arguments
    with suppress(SystemExit):  # of a closed pipe
        terminal.console().print(text)
    sys.exit(0)
