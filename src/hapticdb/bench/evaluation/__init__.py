"""What a reader gets of the measured cells: plots (SVG) and the written evaluation (Markdown)."""
