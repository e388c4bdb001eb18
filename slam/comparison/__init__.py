"""Comparison runs for research: data sets x configurations x seeds, each in its own process, on Dask."""
