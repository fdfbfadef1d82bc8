"""Atlantis, played.

In: seeds and actions. Out: observations, the game's own rewards, the ends of episodes.

What has been saved plays on as if it had never stopped, in any number of worker processes.
This wing must not know what an observation is used for: no replay, no network, no learner, no config.
"""
