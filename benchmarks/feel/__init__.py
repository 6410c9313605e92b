"""How good the forces feel: measures of both laws on closed forms and on a walk over a model."""
