"""Independent peers, run live: other people's programs on the package's own cases.

Each module holds a validation section and skips it, with the reason, where its peer is absent.
"""
