"""The star cameras of one satellite against one another, and the noise of their attitudes."""
