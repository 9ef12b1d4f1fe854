"""The paper's tables and figures, and what follows from them."""
