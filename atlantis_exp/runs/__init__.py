"""What a run is on disk: its folder, who holds it, its journal, its result, its tables of episodes.

In: records and files of whoever works on a run. Out: the same, to whoever reads it; only what is committed counts.
It must not know torch, MLflow, or how a run is trained, played or compared.
"""
