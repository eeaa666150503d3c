"""Mutations: the code broken in one place at a time, to see whether a test notices.

Data flow::

    sites.py: every place that can be broken -> draw.py: so many of them, by seed
        -> trial.py: a copy of the tree, broken, tested -> DIR/mutations/*.json -> score.py: the table

Equivalent mutations, which change no behaviour, are listed with their reasons in equivalent.toml.
"""
