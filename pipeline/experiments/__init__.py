"""The simulations of the paper, run from scratch, as tables and as figures."""
