"""What other machines reach: relay, access, health."""
