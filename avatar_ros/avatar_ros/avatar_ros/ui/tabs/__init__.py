"""The tabs of the planning page with their controls; each works on the parts that it is given."""
