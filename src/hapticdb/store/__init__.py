"""Stores: one class an engine, behind the protocols of `hapticdb.store.base`."""
