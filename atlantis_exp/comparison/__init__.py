"""Which group of runs is better, by how much, how surely.

In: run folders, which are the truth. Out: tables, a verdict, figures and a page as texts and bytes; every number drawn
or written is in a table. It must not know torch, Hydra or MLflow, and holds and writes no run.
"""
