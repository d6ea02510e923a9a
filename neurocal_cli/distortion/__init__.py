"""Which lens the data support, jointly or from straight lines; and what a lens has bent, straightened."""
