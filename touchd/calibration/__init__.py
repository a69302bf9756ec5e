"""Fit plate and discs to the untouched response, so that no robot need touch the plate."""
