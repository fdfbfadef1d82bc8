"""Play a game of ALE.

In: seeds and actions. Out: observations, the game's own rewards, the ends of episodes. A saved game continues exactly,
in any number of worker processes. Only `atlantis.py` knows which game it is; other modules receive its facts. The
package must not know how observations are used: no replay, network, learner or config.
"""
