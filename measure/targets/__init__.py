"""Targets: disks, crosses, coded rings and sheets of dots, detected, identified and measured."""
