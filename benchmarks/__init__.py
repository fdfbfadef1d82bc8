"""Throughput and memory, each module a command that prints a table and, as its last line, one JSON object."""
