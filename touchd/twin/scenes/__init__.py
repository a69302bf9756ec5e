"""What happens on the plate: `catalogue` names the scenes, `timeline` holds one."""
