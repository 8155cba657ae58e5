"""The components of the gas path, one module each; pure functions of symbols."""
