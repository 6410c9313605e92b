"""The endpoint of remote hands that feel by contact proxies."""
