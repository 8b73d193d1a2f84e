"""Attacks on the commands: kills, failing file operations, mutated inputs, hostile surroundings.

``python -m attack`` (with tests/ on the path) runs all of them and prints their counts; ``make attack`` is the
long run of docs/explanation/reliability.md. Linux alone: they fork, and read /proc.
"""
