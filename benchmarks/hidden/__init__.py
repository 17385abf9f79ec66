"""Hidden-effect benchmark: generators that share no code with the tool, sealed answers, scoring, and the tables."""
