"""The version number; package, command line, saved maps and reports read it here."""

__version__ = "0.1.0"
