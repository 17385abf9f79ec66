"""Parity: do the engines agree, stage by stage, over steps and over drives?"""
