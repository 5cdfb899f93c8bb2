"""Who helps whom, what it costs, and what was not sent: live, and in reports."""
