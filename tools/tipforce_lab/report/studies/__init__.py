"""One module per study: STEPS, and studies(effort, advance)."""
