"""Before 8 bits are blamed: are float and INT8 models shown the pixels that the manifest promises?"""
