"""The mounting against time: does it move, how, and since when."""
