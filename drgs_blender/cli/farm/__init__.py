"""Jobs for farm managers, written as each of them wants to have it; none of them is replaced here."""
