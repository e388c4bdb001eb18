"""The one place that tells the version: package, command line, saved maps and reports ask here."""

__version__ = "0.1.0"
