"""Connection to a server: settings, time limits, reconnecting, errors."""
