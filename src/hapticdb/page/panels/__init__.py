"""The panels of a browser, one module a tab."""
