"""From CasADi instructions to torch, JAX and C, and the one discretisation that they share."""
