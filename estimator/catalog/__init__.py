"""On-board catalogs: stars, pairs by separation, and stars by direction."""
