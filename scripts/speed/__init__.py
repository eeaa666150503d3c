"""The programs that `benchmark.py` times: ours and those of other simulators, each in its own venv."""
