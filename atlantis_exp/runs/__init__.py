"""What a run is on disk: its folder, who holds it, its journal, its result, its tables of episodes.

In: the records and files of a session. Out: the same, to any reader; only what is committed counts. It must not know
torch, MLflow, or how a run is trained, played or compared.
"""
