"""One reader a format: a file in, what it holds out, unchecked."""
