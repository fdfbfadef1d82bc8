"""MLflow as a mirror of run folders, which can be thrown away and made again from them.

In: run folders. Out: MLflow runs, here or on a server. It must not know games, networks or how anything is trained;
MLflow itself is imported here alone, on first use.
"""
