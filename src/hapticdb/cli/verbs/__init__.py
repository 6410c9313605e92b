"""The verbs of the command line, one to three a module."""
