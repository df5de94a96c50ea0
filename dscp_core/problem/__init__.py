"""What a problem is: declaration in CasADi symbols, parameters, and what it brings along."""
