"""Keep a run on disk: its folder, lock, journal, result and tables of episodes.

In: the records and files of a session. Out: the committed ones, for any reader. The package must not know torch,
MLflow, or how a run is trained, played or compared.
"""
