"""Why a position stands out, and what structure the residual still has (level 4)."""
