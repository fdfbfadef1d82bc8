"""Measure throughput and memory; each module is a command that prints a table and, as its last line, a JSON object."""
