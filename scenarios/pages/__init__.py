"""Pages that are made from the code and from kept results."""
