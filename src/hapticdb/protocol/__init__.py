"""Messages between a server and its clients, to the byte."""
