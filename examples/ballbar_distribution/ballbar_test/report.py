def chapters(source):
    return []
