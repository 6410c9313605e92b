"""Messages between a server and devices on other machines, to the byte."""
