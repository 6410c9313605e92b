"""The browser view: the scene, tools, and panels."""
