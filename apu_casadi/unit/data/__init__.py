"""Units that come with the package, each an engine file with the source of every number."""
