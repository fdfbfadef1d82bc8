"""Networks that play: one network a file.

In: a float tensor of states in [0, 1], (B, stack, H, W). Out: one value per action, q_BA, or quantiles of it, z_BAN.
They know no optimizer, no objective, no replay, no game and no config.
"""
