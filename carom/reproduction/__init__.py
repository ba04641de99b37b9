"""The paper's tables, learned and measured again: `carom reproduce`.

`jobs.py` is one training, `tables.py` says which trainings a table needs and what its cells are, `results.py` sets
what was measured beside the paper, and `pages.py` and `figure.py` make it readable.
"""
