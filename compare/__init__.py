"""The comparison of methods: any grid of sessions, methods, seeds, budgets and conditions, on several processes."""
