"""What the agent has lived through, exact byte for byte, within a fixed number of bytes.

Observations, actions and rewards enter one step at a time; batches of transitions leave, chosen by a sampler.
It must not know where observations come from, what is learned from them, or how a checkpoint is written.
"""
