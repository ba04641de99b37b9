"""The paper's tables, learned and measured again: `carom reproduce`.

`jobs.py` is one training, `tables.py` says which trainings a table needs and what its cells are, `results.py` puts both
into files.
"""
