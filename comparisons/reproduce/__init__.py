"""The tables of the paper, made again: one module a table, its published numbers beside ours."""
