"""Measurements for developers, and all figures of the documents in one sitting: `python -m tests.benchmarks`."""
