"""The browser view, on viser: scene, tools and panels."""
