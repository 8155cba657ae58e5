"""What the package says beside what somebody else says."""
