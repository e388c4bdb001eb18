"""Research comparison runs: data sets x configurations x seeds, each run in a process of its own, on Dask."""
