"""Sessions on file: frames laid out, packed, written, read and replayed."""
