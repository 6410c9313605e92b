"""Disassembly: in which order parts come out, so that others can."""
