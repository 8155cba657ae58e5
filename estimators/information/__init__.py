"""What can be known at best, and whether an estimate is as good as it says."""
