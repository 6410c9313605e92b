"""Storage engines behind the protocols of `hapticdb.store.base`, one class each."""
