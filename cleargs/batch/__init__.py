"""Many scenes: the sheet that lists them, the loop that runs them, the page that shows them."""
