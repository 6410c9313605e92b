"""An environment on several servers: a coordinator, and shards that hold the rows."""
