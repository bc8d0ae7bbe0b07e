"""Random registration problems by the paper's protocol (section XI-A). (placeholder to import)"""
