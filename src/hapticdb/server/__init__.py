"""What other machines reach: relay, access, endpoints of devices, health."""
