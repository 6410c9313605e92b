"""Pictures: the demo's image, and reports of clashes."""
