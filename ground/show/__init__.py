"""What people look at: reports, lists, pictures and the viewer's page."""
