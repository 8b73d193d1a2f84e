"""Data in layouts of others, read in place: what a layout says, and nothing that it does not."""
