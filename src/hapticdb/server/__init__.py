"""HTTP and WebSocket server of the browser view: relay, access, limits, health."""
