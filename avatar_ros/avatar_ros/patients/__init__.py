"""Building a patient's vademecum beside a node that keeps answering: a supervised process that
holds the atlas, reports progress and can be cancelled; a file is written as a whole or not at
all.
"""
