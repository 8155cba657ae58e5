"""Component maps: tables, their files and checks, and the smooth surfaces made from them."""
