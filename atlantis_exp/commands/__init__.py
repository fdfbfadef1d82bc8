"""One module a verb: its schema, its overrides and one call.

In: what a person typed. Out: checked values for the floors below. Hydra, OmegaConf and the command line live here and
nowhere else; what a verb does lives in `sessions`.
"""

import importlib
import sys
from pathlib import Path

VERBS = {
    "train": "one run, from a composed config; the same command again continues or reports it (the default verb)",
    "search": "the best values of any keys, by Optuna: trials=20 optimizer=adam,rmsprop",
    "evaluate": "a stored run's network, played again: run=NAME epsilon=0.05; an exported one: weights=FOLDER",
    "export": "a stored run's network as a folder to hand on: weights, card and scores: run=NAME to=pretrained/NAME",
    "baseline": "a player without a network as a tracked run: agent=random, agent=constant",
    "play": "a person at the keyboard as a tracked run: player=NAME",
    "decide": "the question itself: trains the seeds that it needs, stops when it is answered: model=cnn,resnet_fast",
    "compare": "finished runs as groups: intervals, a verdict, a page of figures: by=model,sampler",
    "query": "what the environment is, and what this config makes of it",
    "check": "do components keep what the rest relies on, and what do they cost: model=mynet plugins=./mynet.py",
    "new": "a package with a component of your own, to begin with: model=mynet to=FOLDER",
    "verify-resume": "proves, for any training, that killing and continuing it changes no bit",
    "report": "the results that the outputs folder holds, as a table",
    "sync": "run folders into an MLflow store; to=URI to a server, from=URI from one, every=30s until interrupted",
    "ui": "the MLflow UI on the local store",
}
"""Each verb and what it does, as `--help` lists them."""

_PACKAGE = Path(__file__).resolve().parents[1]
CHECKOUT = _PACKAGE.parent
CONF = _PACKAGE / "conf" if (_PACKAGE / "conf").is_dir() else CHECKOUT / "conf"
"""The config groups, those of a checkout or those that an installed package brings."""


def main() -> None:
    """Run the verb that the command line names first; only its own module is imported."""
    first, *rest = sys.argv[1:] or [""]
    if first in VERBS:
        verb, arguments = first, rest
    elif first and "=" not in first and first[0] not in "-~+":
        from atlantis_exp.checking import nearest

        print(f"atlantis_exp: {first}: no such verb; {nearest(first, VERBS)}", file=sys.stderr)
        sys.exit(2)
    else:
        verb, arguments = "train", sys.argv[1:]
    if {"--help", "-h"} & {*arguments}:
        from atlantis_exp import terminal
        from atlantis_exp.commands.helping import help_text

        terminal.console().print(help_text(verb, arguments))  # which a reader that has had enough does not hurt
        sys.exit(0)
    if "--version" in arguments:
        from importlib.metadata import version

        print(f"atlantis-exp {version('atlantis-exp')}")
        sys.exit(0)
    try:
        importlib.import_module(f"atlantis_exp.commands.{verb.replace('-', '_')}").VERB.run(arguments)
    except KeyboardInterrupt:  # before there is anything to lose, or a verb would have said so
        print("atlantis_exp: interrupted", file=sys.stderr)
        sys.exit(130)  # 128 + SIGINT
