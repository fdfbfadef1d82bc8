"""Decide which group of runs is better, by how much, and how surely.

In: run folders. Out: tables, a verdict, figures and a page, as texts and bytes; every number drawn or written is in a
table. It must not know torch, Hydra or MLflow, and neither holds nor writes a run.
"""
