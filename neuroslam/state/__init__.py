"""What a brain is written down with: cells that step, tables that grow, files that are checked."""
