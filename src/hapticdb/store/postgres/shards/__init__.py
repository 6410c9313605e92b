"""An environment's rows on several servers."""
