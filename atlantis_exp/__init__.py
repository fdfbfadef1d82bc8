"""Which network plays Atari Atlantis better on this machine, and how sure are we."""
