"""Pictures: functions that return a matplotlib `Figure` (Agg, no pyplot state) and functions that write one."""
