"""Finished run folders enter; tables, a verdict, figures and a page that shows them leave.

Every number drawn or written stands in a table. Knows no torch, no Hydra and no MLflow: run folders are the truth.
"""
