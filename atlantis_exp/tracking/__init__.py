"""MLflow as a mirror of run folders, which can be thrown away and made again from them.

In: run folders. Out: MLflow runs, here or on a server, and folders made again from these. It must not know games,
networks or how anything is trained; MLflow itself is imported by `store` alone, on first use.
"""
