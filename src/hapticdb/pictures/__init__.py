"""Pictures: the demo's, and the page of clashes."""
