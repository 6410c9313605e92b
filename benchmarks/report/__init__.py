"""The written evaluation (docs/evaluation.md): its chapters, reasons and plots, from results/."""
