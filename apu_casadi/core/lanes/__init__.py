"""CasADi functions evaluated for many points at once in compiled vector code."""
