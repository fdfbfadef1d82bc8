"""Remember the agent's experience losslessly, within a fixed number of bytes.

In: observations, actions and rewards, one step at a time. Out: batches of transitions, chosen by a sampler. The package
must not know where observations come from, how they are learned from, or how a checkpoint is written.
"""
