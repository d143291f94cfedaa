"""Which methods, sessions, seeds, budgets and conditions are compared, and the processes that make the rows."""
