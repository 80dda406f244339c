"""Simulations of the paper's section 3, with its printed values beside ours, as tables and figures."""
