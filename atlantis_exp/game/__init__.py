"""A game of ALE, played.

In: seeds and actions. Out: observations, the game's own rewards, the ends of episodes. A saved game goes on exactly, in
any number of worker processes. `atlantis.py` alone knows which game it is; other modules are handed its facts. It must
not know how an observation is used: no replay, no network, no learner, no config.
"""
