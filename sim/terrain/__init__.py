"""The ground that machines drive on: heights, zones of soil, and what each soil does to wheels."""
