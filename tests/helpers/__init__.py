"""What tests share: fixtures, small worlds, drawn frames, and cases that benchmarks measure too."""
