"""The paper's experiments on any environment: what is asked, how it is timed, what is drawn."""
