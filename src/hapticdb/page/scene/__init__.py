"""The scene of the browser view: objects as meshes, picked, hidden, coloured and moved."""
