"""Scenes on the plate: `catalogue` names them, `timeline` holds one."""
