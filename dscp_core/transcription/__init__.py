"""From a declaration to a family of cone programs with one sparsity pattern."""
