"""The paper's tables and figures, and experiments derived from them."""
