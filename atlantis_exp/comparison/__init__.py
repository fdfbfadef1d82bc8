"""Which group of runs is better, by how much, how surely.

In: finished run folders, which are the truth. Out: tables, a verdict, figures and a page; every number drawn or written
is in a table. It must not know torch, Hydra or MLflow.
"""
