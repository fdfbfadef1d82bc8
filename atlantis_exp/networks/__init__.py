"""Map states to action values: one network a file.

In: a float tensor of states in [0, 1], (B, stack, H, W). Out: one value per action, q_BA, or quantiles of it, z_BAN.
Networks know no optimizer, objective, replay, game or config.
"""
