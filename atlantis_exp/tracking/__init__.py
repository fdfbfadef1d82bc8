"""Mirror run folders in MLflow, whose store can be deleted and rebuilt from them.

In: run folders. Out: MLflow runs, here or on a server. The package must not know games, networks or training. Only this
package imports MLflow, on first use.
"""
