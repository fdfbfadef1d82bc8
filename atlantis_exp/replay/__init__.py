"""What the agent has lived through, exact byte for byte, within a fixed number of bytes.

In: observations, actions and rewards, one step at a time. Out: batches of transitions, chosen by a sampler.
It must not know where observations come from, how they are learned from, or how a checkpoint is written.
"""
