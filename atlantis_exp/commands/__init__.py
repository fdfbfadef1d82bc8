"""One module a verb: overrides enter, a checked config is composed, built and called.

Hydra and OmegaConf live here and nowhere else; what a verb does lives on the floors below.
"""

VERBS = {
    "train": "one run, from a composed config; the same command again continues or reports it (the default verb)",
    "search": "the best values of any keys, by Optuna: trials=20 optimizer=adam,rmsprop",
    "evaluate": "a stored run's network, played again: run=NAME epsilon=0.05; an exported one: weights=FOLDER",
    "export": "a stored run's network as a folder to hand on: weights, card and scores: run=NAME to=pretrained/NAME",
    "baseline": "a player without a network as a tracked run: agent=random, agent=constant",
    "play": "a person at the keyboard as a tracked run: player=NAME",
    "compare": "finished runs as groups: intervals, a verdict, a page of figures: by=model,sampler",
    "query": "what the environment is, and what this config makes of it",
    "verify-resume": "proves, for any training, that killing and continuing it changes no bit",
    "report": "the results that the outputs folder holds, as a table",
    "sync": "run folders into an MLflow store; to=URI to a server, from=URI from one, every=30s until interrupted",
    "ui": "the MLflow UI on the local store",
}
"""Each verb and what it does, as `--help` lists them."""
