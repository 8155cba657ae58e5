"""What a command does about signals, streams, locks and worker processes."""
